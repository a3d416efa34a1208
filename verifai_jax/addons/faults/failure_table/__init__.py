"""The failure table: failure modes and effects of faults, each with its counterexample.

table = fmea(problem, faults, rate=1e-4, mission_time=8)
print(table)
table.table, table["gyro_dropout"].probability, table.plot(), table.to_csv("fmea.csv")
"""

from verifai_jax.addons.faults.failure_table._fmea import fmea as fmea
from verifai_jax.addons.faults.failure_table.result import Effect as Effect
from verifai_jax.addons.faults.failure_table.result import FailureTable as FailureTable
