"""A page to work in: a session is a folder, each click a command line, nothing leaves the machine.

`sessions` keeps the files, `steps` turns choices into command lines, `work` runs these in
processes, `panels` and `cell` show what they wrote, `guard` keeps strangers out, `routes` and
`server` bring it together.
"""
