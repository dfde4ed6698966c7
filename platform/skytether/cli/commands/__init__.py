"""The commands, one file for each noun or verb; those with many of their own have a folder.

What a command prints and how it waits is shared in `skytether.cli`. What is no command (schemas of files, what is
measured, what is decided) belongs in the package that it is about.
"""
