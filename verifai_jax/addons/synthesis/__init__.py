"""Parameters for which a formula holds: chosen by `synthesize`, or changed by `repair`."""
