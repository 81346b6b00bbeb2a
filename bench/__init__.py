"""Measurements: each module is one, ``python -m bench.NAME``; ``python -m bench.run`` runs them in turn."""
