"""The measured data: modal data, covariances of frequencies, and repeated tests.

Reading order: modal_data, covariance, repeated.
"""
