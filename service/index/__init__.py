"""The index of a data folder: its tables, the one writer, the questions, the journal it is made again from.

Nothing here knows of HTTP, and nothing starts or watches a process.
"""
