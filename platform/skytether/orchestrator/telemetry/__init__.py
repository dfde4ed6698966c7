"""What others are told: metrics, what robots and services report, the log, the audit.

It counts and writes down. Nothing is placed, started or refused for what is here.
"""
