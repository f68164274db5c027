"""Measured data: modal data, frequency covariances, repeated tests, and frequency response functions.

Reading order: covariance, repeated, modal_data, expected; the folder frf, frf_data, read_frf, held_out_lines,
picked_modes.
"""
