"""Plan a modal test: choose sensors, and compare modes, repeats and structural changes by expected information.

Reading order: `plan`, `before`, `linearised`, `targets`, `design`; in `sensors`: `information`, `choice`, `bound`.
"""
