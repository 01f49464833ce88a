"""What a job is and how it comes to its end: states, the scheduler, backends, the runner, the start of the solver.

Nothing here knows of HTTP or of a terminal; the runner opens no database.
"""
