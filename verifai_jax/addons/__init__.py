"""Add-ons: each a small house that uses the core as a stranger would."""
