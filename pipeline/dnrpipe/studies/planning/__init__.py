"""`dnrpipe plan`: what a budget of time buys, or what an error costs, before it is spent.

make_plan     pilot, prediction, choice; writes ``plan/plan.json``
records       what stands in ``plan/pilot.json`` and ``plan/plan.json``
pilot         small runs of everything that costs time, kept in ``plan/pilot.json``
pilot_worker  its training and frames, in a process of their own
seconds       pilot -> seconds of every stage (straight lines, each with its slope and its start)
quality       pilot and prior -> PSNR by views, samples and steps
choose        the views, samples and steps that a budget or a target calls for
routes        whether to train at all: neural renderer, base image alone, or path tracing with a denoiser
carry_out     select, ray-trace, then train for the time that is left
plan_text     tables and sentences
"""
