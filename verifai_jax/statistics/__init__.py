"""Pure numbers: intervals of rates, stopping rules, Pareto fronts, least-distance steps."""
