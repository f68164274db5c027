"""Frames of three-dimensional beams: sections, joints, assembly, and the terms that each parameter changes.

Reading order: components, beam, updates, frame; then stability, drawing.
"""
