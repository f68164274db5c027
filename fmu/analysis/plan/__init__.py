"""Plan a modal test: find the sensors, modes and structural changes that best determine the parameters.

Reading order: `plan`, `before`, `linearised`, `targets`, `design`; in `sensors`: `information`, `choice`, `bound`.
"""
