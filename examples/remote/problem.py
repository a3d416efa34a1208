"""A problem whose simulator is another program:

    verifai-jax falsify examples/remote/problem.py:swing --search uniform --budget 1000

waits at port 4567 for as many of `pendulum.py`, or the compiled `pendulum.c` beside it, as there
are cores.
"""

import verifai_jax as vj

swing = vj.Problem(
    "swing",
    {"theta0": vj.Box(-1.5, 1.5), "length": vj.Box(0.2, 2.0)},
    vj.remote(port=4567, signals=("theta", "omega"), dt=0.02, length=200),
    "always abs(omega) <= 8",
    description="a pendulum in another program must not swing faster than 8 rad/s",
)
