"""The running program: assembles the rooms, schedules jobs, answers requests and commands.

Why so: the rooms below stay pure because everything with a life (database handle, cluster, server,
process) begins and ends here.
"""
