"""View selection: geometric and coverage policies and the paper's Q-learning selector, behind one protocol."""
