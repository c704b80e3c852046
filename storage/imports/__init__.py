"""Foreign files on their way in: control marks, truth, rigs, plans, terrains."""
