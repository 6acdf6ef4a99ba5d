#!/usr/bin/env bash
# Makes the weights of segmenter=compact_instances: labelled views of eight built-in towns, of colours that change from
# picture to picture, and of five open city models; then ten minutes of training from the weights of compact.
# Two cores, no GPU, extra [torch]. Usage: recipes/compact_instances.sh OUT CITIES, with OUT a folder for everything, CITIES
# that of the open models. Given again it goes on where it stopped.
set -euo pipefail
out=$1
cities=$2
views=${VIEWS:-80} # of each town
epochs=${EPOCHS:-5}

generate() { # set, views, further settings
    lodbench generate-training-data out="$out/$1" limit="$2" count="$((4 * $2))" "${@:3}" labels=true \
        sampling=random size='[512,384]' min_buildings=0.02 val_share=0 test_share=0 sheet=32 \
        height='[60,75,90,105,120,135,150,165,180,200]' pitch='[0,10,20,30,40,50,60,70]'
}

fields=(70 62 70 75)
for seed in 1 2 3 4 5 6 7 8; do
    generate "train/town$seed" "$views" city="demo:$seed" lod=3 seed="$((50 + seed))" \
        fov_deg="${fields[(seed - 1) % 4]}" look.repaint='[0,1]' look.tint_jitter='[0.02,0.3]'
done
few=$((3 * views / 4))
generate train/delft "$few" source=threedbag lod=2.2 seed=61 fov_deg=62 \
    city="$cities/3dbag/3dbag_v210908_fd2cee53_5907_subset.json"
generate train/nishitokyo "$few" source=plateau seed=62 fov_deg=70 city="$cities/plateau/53395404_bldg_6697_op.gml"
generate train/rotterdam "$few" seed=63 fov_deg=75 city="$cities/netherlands_other/3-20-DELFSHAVEN.city.json"
generate train/berlin "$few" seed=64 fov_deg=65 city="$cities/germany_lod2/berlin_open_data_sample_data.citygml"
generate train/nrw "$few" seed=65 fov_deg=70 city="$cities/germany_lod2/LoD2_32_280_5657_1_NW.gml"
generate val/town9 "$((views / 2))" city=demo:9 lod=3 seed=9 fov_deg=70

compact=$(python -c 'from lodbench.segmentation.packaged import packaged_weights; print(packaged_weights())')
OMP_NUM_THREADS=1 lodbench train segmenter=compact_instances data="$out/train" val_data="$out/val/town9" \
    out="$out/weights" threads=1 precision=bfloat16 device=cpu init="$compact" schedule.epochs="$epochs" \
    schedule.lr=0.0015 schedule.muon_lr=0.006 schedule.one_band=0.04 schedule.crop=320 schedule.batch=6 \
    schedule.scale='[0.75,1.35]' schedule.val_every=1
echo "compact_instances.onnx and training.json (as compact_instances.json) of $out/weights belong in lodbench/segmentation/weights"
