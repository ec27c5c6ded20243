"""The pipeline as a service: a durable queue of jobs, a worker process per device, a web application on top.

client ── HTTP ──► application (app, routes_*) ──► queue (SQLite) ◄── worker ──► `dnrpipe <stage> -w WORKSPACE`
       ◄── SSE ───                                                     (one process per device)
       ◄─ WebSocket ─► live viewer (live_*) ──► frame process (one per viewed workspace)
"""
