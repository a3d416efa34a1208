"""Fuzzing: simulations that show new behaviour, with or without a formula."""
