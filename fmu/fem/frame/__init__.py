"""Frames of three-dimensional beams: sections, joints, assembly, and which terms a parameter changes.

Reading order: components, beam, updates, frame; then stability, drawing.
"""
