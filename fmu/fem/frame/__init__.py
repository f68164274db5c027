"""Frames of three-dimensional beams: sections, joints, assembly, and which terms a parameter changes.

Reading order: section, beam, joints, updates, frame; then numbering, stability, motion, drawing.
"""
