"""Analyse recorded flights: tables of their samples, a summary, a report, exports, comparisons, and recovery."""
