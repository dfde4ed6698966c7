"""What has to outlast a program: tables, migrations, statements, and who of several orchestrators leads.

Nothing here decides what is to be done, or who may ask for it. SQL is nowhere else.
"""
