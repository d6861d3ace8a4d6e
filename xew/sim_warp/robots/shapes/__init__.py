"""What the five robots look like and collide with: one file a robot, written into its URDF by `author`."""
