"""From a record to coefficients: whitening, sensitivities, descent, covariance, tests."""
