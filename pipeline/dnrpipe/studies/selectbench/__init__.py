"""`dnrpipe bench-select`: policies of view selection on the same scenes, candidates, budgets, model and time."""
