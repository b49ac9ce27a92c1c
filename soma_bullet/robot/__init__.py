"""The robot: the described cell, its kinematics, and the collision model that planning uses."""
