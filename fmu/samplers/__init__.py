"""The answer: Markov-chain samplers, which see a log-density and nothing of finite elements."""
