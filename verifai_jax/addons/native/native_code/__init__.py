"""Programs that JAX traced, translated to vector code for the machine's own compiler."""
