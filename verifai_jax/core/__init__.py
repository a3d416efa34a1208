"""The ground of every room, in six folders; it imports no other room."""
