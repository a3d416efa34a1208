#!/bin/sh
# Install a wheel into an environment of its own and use it from another directory.
set -eu
wheel=$(cd "$(dirname "$1")" && pwd)/$(basename "$1")
python=$(pwd)/.venv/bin/python
constraints=$(pwd)/constraints.txt
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
"$python" -m venv "$place/venv" 2>/dev/null || "$python" -m venv --without-pip --clear "$place/venv"
if [ -x "$place/venv/bin/pip" ]; then
  "$place/venv/bin/python" -m pip install -q --disable-pip-version-check -c "$constraints" "$wheel"
else
  python3 -m pip --python "$place/venv/bin/python" install -q -c "$constraints" "$wheel"
fi
cd "$place"
cat > pendulum.py <<'PY'
import jax.numpy as jnp

import verifai_jax as vj

swing = vj.Problem(
    "swing",
    space={"angle": vj.Box(-1.0, 1.0)},
    system=vj.ode(
        lambda time, state, control, features: {
            "angle": state["speed"],
            "speed": -9.81 * jnp.sin(state["angle"]),
        },
        lambda features, key: {"angle": features["angle"], "speed": jnp.zeros(())},
        dt=0.02,
        duration=2.0,
    ),
    spec="always[0, 2] abs(angle) <= 0.9",
)
PY
venv/bin/verifai-jax doctor
venv/bin/verifai-jax falsify pendulum.py:swing --budget 500 --seed 1 | tee out
grep -q "simulations violate the property" out
test -s runs/swing-1/table.parquet
venv/bin/verifai-jax report runs/swing-1 --traces 2 --no-studies
test -s runs/swing-1/report.html
venv/bin/verifai-jax new my_project
(cd my_project && ../venv/bin/python test_spec.py)
venv/bin/python -c "
from importlib.metadata import entry_points
assert '_verifai_jax_pytest' in [entry.value for entry in entry_points(group='pytest11')]
"
test -s "$(venv/bin/python -c "import sysconfig; print(sysconfig.get_path('purelib'))")/_verifai_jax_pytest.py"
if venv/bin/python -c "import envs" 2>/dev/null; then echo "the wheel ships envs" >&2; exit 1; fi
