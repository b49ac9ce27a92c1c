"""The assembly planner: stability, graspability, assemblability and assisting support of every order, and the
best one."""
