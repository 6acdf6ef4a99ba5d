#!/usr/bin/env bash
# Makes the weights of method=lodloc: 40 views each of five built-in towns, then 14 passes over them, ten minutes on
# one core. Needs the extra [torch].
# Usage: recipes/lodloc.sh OUT, with OUT a folder for everything. Given again it goes on where it stopped.
set -euo pipefail
out=$1
fields=(84 62 70 75)

for seed in 1 2 3 4 5; do
    lodbench generate-training-data out="$out/sets/town$seed" city="demo:$seed" lod=3 seed="$((100 + seed))" \
        fov_deg="${fields[seed % 4]}" limit=40 count=160 sampling=random size='[640,480]' min_buildings=0.02 \
        val_share=0 test_share=0 sheet=128 height='[50,60,75,90,110,135,165,200,250,300]' \
        pitch='[0,4,8,12,16,24,32,40,50,60,70]' look.repaint='[0.2,1]' look.tint_jitter='[0.02,0.3]' \
        look.sun_share='[0.05,0.92]' look.sun_elevation_deg='[12,70]' look.exposure='[0.7,1.5]' look.contrast='[0.85,1.4]'
done
lodbench train method=lodloc data="$out/sets" out="$out/weights"
echo "lodloc.onnx and training.json (as lodloc.json) of $out/weights belong in baselines/lodloc/weights"
