"""The user's own code: its files, the objects in it, its callbacks and its errors."""
