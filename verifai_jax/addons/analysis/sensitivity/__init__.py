"""Sensitivity of the robustness to each feature, by Morris, by Sobol and by gradients."""
