import jax
import numpy as np
import pandas as pd

from tests.addons.events.test_automaton import POINTS, SPACE
from verifai_jax.addons.analysis.data.columns import feature_columns


def test_columns_of_a_table_with_events_are_those_of_the_space():
    rows = SPACE.rows(jax.tree.map(np.asarray, SPACE.features_at(POINTS[:8])))
    assert feature_columns(pd.DataFrame(rows), SPACE) == SPACE.columns
