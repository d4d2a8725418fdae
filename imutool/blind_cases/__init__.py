"""Blind cases of `conceal`: their generator, envelope and score; no code of the estimator."""
