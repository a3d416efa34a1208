"""Systems under test: anything that turns features and a random key into a trace."""
