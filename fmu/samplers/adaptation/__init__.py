"""When the warm-up adapts, and what it learns from; each sampler has its tuner beside it.

Reading order: schedule, learner.
"""
