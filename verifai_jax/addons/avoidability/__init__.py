"""The last instant at which a failure could still have been avoided (`last_chance`)."""
