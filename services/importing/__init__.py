"""Images that other instruments took, as frames of endo3d."""
