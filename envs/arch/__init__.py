"""The models of the ARCH competition in falsification, in pure JAX; see `docs/arch_comp.md`.

Each is a function that gives a system: `automatic_transmission`, `chasing_cars`,
`neural_network_controller`, `f16` and `pacemaker`, in the file of that name.
"""
