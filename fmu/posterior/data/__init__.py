"""What was measured: modal data, and repeated tests.

Reading order: modal_data, covariance, repeated.
"""
