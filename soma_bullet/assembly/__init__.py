"""The thing to build: workpieces, goal poses, the file that describes them, and the contacts between them."""
