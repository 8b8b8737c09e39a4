"""Gate for estimates, fix type with accuracies, and prediction of the estimate to the time of sending."""
