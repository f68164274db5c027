"""The measured data: modal data, covariances of frequencies, repeated tests, and frequency response functions.

Reading order: modal_data, covariance, repeated; frf_data, then the folder frf.
"""
