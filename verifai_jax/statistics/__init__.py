"""Statistics and small programs over plain numbers: intervals, stopping rules, Pareto fronts."""
