"""The paper's experiments on the virtual rig, through the services' own steps."""
