"""What each contact law's first-order gradients cost and buy: tables of docs/which-contact.md.

`scenes` has the tasks, `measure` what is measured of them, `page` the tables; `python -m experiments.laws` measures.
All at MuJoCo's default stiffness: K is that of solref (0.02, 1) for the contact's effective mass.
"""
