"""Planning of a modal test: the sensors, modes and changes of a structure that tell most about its parameters.

Reading order: `plan`, `before`, `linearised`, `targets`, `design`; in `sensors` `information`, `choice`, `bound`.
"""
