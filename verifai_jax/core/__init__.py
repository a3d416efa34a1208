"""The base of all other rooms, in six folders; it imports no other room."""
