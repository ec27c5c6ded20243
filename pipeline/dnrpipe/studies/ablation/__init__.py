"""`dnrpipe ablate`: variants of the neural renderer on the same scenes, views, references and machine."""
