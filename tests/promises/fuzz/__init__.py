"""Fuzzing: every decoder, file reader and message of a server against what nobody would send on purpose.

``make fuzz`` runs it, guided by coverage (atheris); ``python -m tests.promises.fuzz --help`` says how. A target
(``targets.py``) takes bytes and raises only what it says that it raises. What was found, and what leads into corners,
is kept in ``corpus/TARGET`` and replayed by the ordinary tests.
"""
