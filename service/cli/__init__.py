"""The command `frit`: a file for each group of its verbs, and what they share at the terminal.

What a command does is done elsewhere: by a service, the engine or the solver.
"""
