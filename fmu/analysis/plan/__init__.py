"""Planning of a modal test: the sensors, modes and changes of a structure that best determine its parameters.

Reading order: `plan`, `before`, `linearised`, `targets`, `design`; in `sensors` `information`, `choice`, `bound`.
"""
