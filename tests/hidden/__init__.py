"""Records with a hidden effect, made without any code of the estimator."""
