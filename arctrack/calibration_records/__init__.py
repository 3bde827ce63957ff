"""What calibrations write: values for a setup with their covariance, and the records beside them."""
