"""Fuzzing: every decoder, file reader and server message against input that no one would send on purpose.

``make fuzz`` runs it, guided by coverage (atheris); ``python -m tests.promises.fuzz --help`` says how. A target
(``targets.py``) takes bytes and raises only the documented errors. Earlier findings and inputs that reach corner cases
are kept in ``corpus/TARGET`` and replayed by the ordinary tests.
"""
