import sys, warnings
from flow import *
from search import *
for seed in map(int, sys.argv[1:]):
    c, truth, p, records = made(seed)
    with warnings.catch_warnings(), own_arithmetic():
        warnings.simplefilter("ignore")
        model = handed(p, c["handed"])
        case = case_of(model, records, controller=controller(p) if p.loop else None)
        s = Search(case).run()
        for v, tr in s.table()[:3]:
            pv, tests = s.tested(tr)
            print(seed, round(v), words(s, tr), 'p', pv, 'odds', s.odds.get(id(tr)), [(t.name, float(f"{t.p_value:.2g}"), t.dof) for t in tests], tr.own, tr.problem.substeps)
