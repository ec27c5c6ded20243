"""View selection: the paper's Q-learning selector and the baselines, behind one protocol."""
