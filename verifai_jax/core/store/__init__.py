"""All that is on disk: files that are whole, logs of entries, caches of finished work, locks."""
