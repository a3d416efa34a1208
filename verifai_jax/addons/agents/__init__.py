"""Part of an add-on."""
