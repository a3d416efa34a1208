"""Sweeps over hyper-parameters of training, ranked by the safety of what was trained."""
