"""Tables as numbers: their columns, their samples, and the prior of each column."""
