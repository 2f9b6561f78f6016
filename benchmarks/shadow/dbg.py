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
    s.add(s.empty(s.fitted))
    print('strong', s.strong, 'library', len(case.library))
    scored = candidate_columns(s.fitted, case.library, s.motion, (0.0, 1.0))
    for screen in s.screens(s.fitted, scored, bool(s.numbers)):
        print(screen.ratio, screen.whitener.orders, len(screen.groups), [(round(v), [(g.effect.label) for g in gs]) for v, gs in screen.beam(1, False, s.price)[:10]])
        print('   sets', [(round(v), [(g.effect.label) for g in gs]) for v, gs in screen.beam(3, True, s.price, usable=s.is_law)[:4]])
    kind = sys.argv[2]
    screens = s.screens(s.fitted, scored, bool(s.numbers))
    for screen in screens:
        own = [g for g in screen.groups if g.effect.kind == kind]
        own = sorted(own, key=lambda g: -screen.solve([g], False)[0])[:2]
        for g in own:
            values, theta, x0 = screen.start([g], False, s.fitted)
            tr = s.refit((g.effect,), s.fitted, [(values, theta, x0)], led=True)
            print(screen.ratio, values, theta, x0, s.base_cost, tr and (tr.total, tr.fit, tr.own, tr.noise.names))
            tr = s.refit((g.effect,), s.fitted, [(values, s.fitted.theta, s.fitted.problem.unpack(s.fitted.point)[1])], led=True)
            print('    plain x0', tr and (tr.total, tr.fit, tr.own, tr.noise.names))
