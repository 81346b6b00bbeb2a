"""What a message looks like: in Rerun, in a picture, in a figure."""
