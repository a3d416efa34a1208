"""Functional Mock-up Units (FMI 2 and 3) as systems."""

from verifai_jax.addons.simulators.fmu._fmu import fmu as fmu
from verifai_jax.addons.simulators.fmu._fmu import fmu_ranges as fmu_ranges
from verifai_jax.addons.simulators.fmu._fmu import fmu_variables as fmu_variables
