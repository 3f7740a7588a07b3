"""Static equilibrium of hyperelastic bodies by finite elements, batched, in torch float64."""
