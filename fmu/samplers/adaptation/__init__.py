"""What is tuned in warm-up, and when.

Reading order: schedule, tuners.
"""
