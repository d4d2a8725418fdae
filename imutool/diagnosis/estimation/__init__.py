"""The estimator: effects found and fitted on whitened residuals of aligned logs."""
