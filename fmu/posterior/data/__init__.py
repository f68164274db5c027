"""Measured data: modal data, frequency covariances, repeated tests, and frequency response functions.

Reading order: covariance, estimated_sd, repeated, modal_data, stacked, expected; the folder frf, frf_data,
read_frf, held_out_lines, picked_modes.
"""
