"""The posterior of the parameters theta: priors, measured data, error models and the log-probability."""
