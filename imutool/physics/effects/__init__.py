"""The catalogue of effects: one file an effect."""
