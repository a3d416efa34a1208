"""Persistence: files written whole, logs of entries, caches of finished work, locks."""
