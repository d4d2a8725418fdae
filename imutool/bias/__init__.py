"""Models of the bias: one file a model, `Config` and `Model(BiasModel)` in each."""
