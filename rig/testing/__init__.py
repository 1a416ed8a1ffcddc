"""Tests of a controller in Python: a bench that runs sequences and commands. rig_pytest.py makes it a fixture."""
