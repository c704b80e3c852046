"""Experiments: simulated worlds through the methods, into tables. Rests on everything else."""
