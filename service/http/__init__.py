"""What is asked and answered over HTTP: routes, what may come in, what goes out, who is let in.

No transaction begins here and no process is started: for that the routes ask the index and the engine.
"""
