"""The ``endo3d`` command."""
