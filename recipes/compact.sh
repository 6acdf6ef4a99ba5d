#!/usr/bin/env bash
# Makes the weights of segmenter=compact: eight built-in towns and, where they are at hand, open city models,
# half an hour of training, then an hour more. Two cores, no GPU, extra [torch].
# Usage: recipes/compact.sh OUT [CITIES], with OUT a folder for everything, CITIES that of the open models.
# Given again it goes on where it stopped.
set -euo pipefail
out=$1
cities=${2:-}
views=${VIEWS:-800} # of each town
first=${FIRST_EPOCHS:-8} second=${SECOND_EPOCHS:-10}

generate() { # set, views, further settings
    lodbench generate-training-data out="$out/$1" limit="$2" count="$((4 * $2))" "${@:3}" \
        sampling=random size='[512,384]' min_buildings=0.02 val_share=0 test_share=0 sheet=128 \
        height='[60,75,90,105,120,135,150,165,180,200]' pitch='[0,10,20,30,40,50,60,70]'
}

fields=(70 62 70 75)
for seed in 1 2 3 4 5 6 7 8; do
    generate "train/town$seed" "$views" city="demo:$seed" lod=3 seed="$seed" fov_deg="${fields[(seed - 1) % 4]}"
done
generate val/town9 100 city=demo:9 lod=3 seed=9 fov_deg=70
if [ -n "$cities" ]; then
    few=$((views / 5))
    generate train/delft "$few" source=threedbag lod=2.2 seed=11 fov_deg=62 \
        city="$cities/3dbag/3dbag_v210908_fd2cee53_5907_subset.json"
    generate train/nishitokyo "$few" source=plateau seed=12 fov_deg=70 city="$cities/plateau/53395404_bldg_6697_op.gml"
    generate train/rotterdam "$few" seed=13 fov_deg=75 city="$cities/netherlands_other/3-20-DELFSHAVEN.city.json"
    generate train/berlin "$few" seed=14 fov_deg=65 city="$cities/germany_lod2/berlin_open_data_sample_data.citygml"
    generate train/nrw "$few" seed=15 fov_deg=70 city="$cities/germany_lod2/LoD2_32_280_5657_1_NW.gml"
fi

train() { # folder, further settings
    torchrun --nproc-per-node=2 --master-port="${PORT:-29517}" -m lodbench train segmenter=compact \
        data="$out/train" val_data="$out/val" out="$out/$1" threads=1 precision=bfloat16 device=cpu "${@:2}"
}
export OMP_NUM_THREADS=1
train first schedule.epochs="$first"
train second schedule.epochs="$second" schedule.lr=0.0015 schedule.muon_lr=0.01 \
    schedule.one_band=0.12 init="$out/first/checkpoint.pt"
echo "compact.onnx and training.json (as compact.json) of $out/second belong in lodbench/segmentation/weights"
