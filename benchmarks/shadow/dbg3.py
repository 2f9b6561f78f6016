import sys, warnings
from flow import *
from search import *
seed=int(sys.argv[1])
c, truth, p, records = made(seed)
with warnings.catch_warnings(), own_arithmetic():
    warnings.simplefilter("ignore")
    model = handed(p, c["handed"])
    case = case_of(model, records, controller=controller(p) if p.loop else None)
    s = Search(case)
    t0=s.add(s.empty(s.fitted)); print(t0.total, t0.fit, t0.noise.names)
    print([(e.label, sz) for e, sz in s.numbers])
    t1=s.add(s.empty(s.floated)); print(t1.by_spread, t1.fit, t1.noise.names, s.floated.refinement.fit, s.floated.theta, s.floated.refinement.message)
