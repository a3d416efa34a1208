"""Training against failures: sweeps of configurations, hardening of a policy, augmented data."""
