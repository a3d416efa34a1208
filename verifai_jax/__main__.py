"""The command line where its script is not on the path: `python -m verifai_jax falsify ...`."""

from verifai_jax.cli.main import main

# A worker process that is spawned imports this file too.
if __name__ == "__main__":
    main(prog_name="verifai-jax")
