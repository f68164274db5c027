"""Measured data: modal data, frequency covariances, repeated tests, and frequency response functions.

Reading order: modal_data, covariance, repeated; frf_data, then the folder frf.
"""
