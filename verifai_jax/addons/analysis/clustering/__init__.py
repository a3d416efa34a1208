"""Clusters of counterexamples, by density or around prototypes."""
