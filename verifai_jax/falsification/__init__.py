"""The search loop, its options, its table and its result."""

from verifai_jax.evaluation.replay import Replay as Replay
from verifai_jax.falsification._falsify import falsify as falsify
from verifai_jax.falsification._falsify import resume as resume
from verifai_jax.falsification._falsify import simulate as simulate
from verifai_jax.falsification._repeat import Trials as Trials
from verifai_jax.falsification._repeat import repeat as repeat
from verifai_jax.falsification.run import Run as Run
from verifai_jax.falsification.run import load as load
from verifai_jax.falsification.running import RunError as RunError
from verifai_jax.falsification.shards import Shard as Shard
from verifai_jax.falsification.shards import merge as merge
from verifai_jax.falsification.shards import simulate_shard as simulate_shard
from verifai_jax.falsification.table import ErrorTable as ErrorTable
