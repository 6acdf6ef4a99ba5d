#!/usr/bin/env bash
# Makes the weights of segmenter=compact: eight built-in towns and, where they are at hand, open city models;
# half an hour of training, as much again on towns repainted as well, then an hour and three quarters on larger squares.
# Two cores, no GPU, extra [torch].
# Usage: recipes/compact.sh OUT [CITIES], with OUT a folder for everything, CITIES that of the open models.
# Given again it goes on where it stopped.
set -euo pipefail
out=$1
cities=${2:-}
views=${VIEWS:-800} # of each town
first=${FIRST_EPOCHS:-8} second=${SECOND_EPOCHS:-5} third=${THIRD_EPOCHS:-12}

generate() { # set, views, further settings
    lodbench generate-training-data out="$out/$1" limit="$2" count="$((4 * $2))" "${@:3}" \
        sampling=random size='[512,384]' min_buildings=0.02 val_share=0 test_share=0 sheet=128 \
        height='[60,75,90,105,120,135,150,165,180,200]' pitch='[0,10,20,30,40,50,60,70]'
}

fields=(70 62 70 75)
for seed in 1 2 3 4 5 6 7 8; do
    fov=${fields[(seed - 1) % 4]}
    generate "train/first/town$seed" "$views" city="demo:$seed" lod=3 seed="$seed" fov_deg="$fov"
    # The same towns in other colours in every picture, so that no palette is learnt by heart.
    generate "train/second/town$seed" "$((views / 2))" city="demo:$seed" lod=3 seed="$((20 + seed))" fov_deg="$fov" \
        look.repaint='[0.3,1]' look.tint_jitter='[0.02,0.3]'
done
generate val/town9 100 city=demo:9 lod=3 seed=9 fov_deg=70
if [ -n "$cities" ]; then
    few=$((views / 5))
    generate train/first/delft "$few" source=threedbag lod=2.2 seed=11 fov_deg=62 \
        city="$cities/3dbag/3dbag_v210908_fd2cee53_5907_subset.json"
    generate train/first/nishitokyo "$few" source=plateau seed=12 fov_deg=70 city="$cities/plateau/53395404_bldg_6697_op.gml"
    generate train/first/rotterdam "$few" seed=13 fov_deg=75 city="$cities/netherlands_other/3-20-DELFSHAVEN.city.json"
    generate train/first/berlin "$few" seed=14 fov_deg=65 city="$cities/germany_lod2/berlin_open_data_sample_data.citygml"
    generate train/first/nrw "$few" seed=15 fov_deg=70 city="$cities/germany_lod2/LoD2_32_280_5657_1_NW.gml"
fi

train() { # folder of sets, folder to write, further settings
    torchrun --nproc-per-node=2 --master-port="${PORT:-29517}" -m lodbench train segmenter=compact \
        data="$out/$1" val_data="$out/val" out="$out/$2" threads=1 precision=bfloat16 device=cpu "${@:3}"
}
export OMP_NUM_THREADS=1
train train/first weights1 schedule.epochs="$first"
train train weights2 schedule.epochs="$second" schedule.lr=0.0015 schedule.muon_lr=0.01 \
    schedule.one_band=0.12 init="$out/weights1/checkpoint.pt"
# From the ONNX file, whose kernels come back with a length of one: steps of one size in all of them.
train train weights3 schedule.epochs="$third" schedule.lr=0.0015 schedule.muon_lr=0.006 schedule.one_band=0.04 \
    schedule.crop=320 schedule.batch=6 schedule.scale='[0.75,1.35]' schedule.val_every=1 \
    init="$out/weights2/compact.onnx"
echo "compact.onnx and training.json (as compact.json) of $out/weights3 belong in lodbench/segmentation/weights"
