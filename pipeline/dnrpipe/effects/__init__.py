"""Which light-transport effects a scene calls for: the plan, its evidence, and what each effect costs."""
