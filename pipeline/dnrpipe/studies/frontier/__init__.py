"""`dnrpipe frontier`: what accuracy costs in time, measured: our choices, baselines, and the best of all."""
