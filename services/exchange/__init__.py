"""What leaves the house: clouds, surfaces, depth maps, trajectories and bags in other programs' formats."""
