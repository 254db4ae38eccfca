import sys,time
from pathlib import Path
from tiny import *
import tempfile
d=Path(tempfile.mkdtemp())
t0=time.time()
t=make_trainer(d/"a"); print("make",time.time()-t0); t0=time.time()
print(t.resume()); t.train(); print("train",time.time()-t0, t.step, t.total_steps)
print(open(d/"a/metrics.csv").read())
import os
for r,_,fs in os.walk(d/"a"): print(r,[(f,os.path.getsize(os.path.join(r,f))) for f in fs])
