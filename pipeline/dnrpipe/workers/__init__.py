"""Task lists on worker processes.

processes    run tasks on workers, survive their deaths, try once more
timeouts     when a task counts as hung
view_tasks   tasks of one file each: skip what is made, book what was done, report failures
"""
