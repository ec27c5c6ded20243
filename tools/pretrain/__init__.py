"""The shipped corrector: its training data, made from the factory's scenes, its training and its judgement."""
