"""Functional mock-up units (FMI 2.0 and 3.0, co-simulation): models of the rig as units, foreign units as plants."""
