"""`dnrpipe plan`: what a budget of time buys, or what an error costs, before it is spent."""
