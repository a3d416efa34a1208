"""Texts for people: errors with value and remedy, checks of arguments, numbers as text."""
