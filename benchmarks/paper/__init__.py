"""The paper's test flight (Mellado-Bataller et al., IAS-12, 2013): flown, recorded, and evaluated.

``python -m benchmarks.paper`` flies it; ``docs/paper.md`` says what it measures.
"""
