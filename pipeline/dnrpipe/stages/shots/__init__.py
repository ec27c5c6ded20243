"""`dnrpipe shot`: from an animated camera to finished frames, by the cheapest way that is good enough."""
