"""From bundle to result: the job, the pool of processes that run jobs, and the commands.
Each step of a job belongs to the package that it calls.
"""
