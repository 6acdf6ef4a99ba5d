#!/usr/bin/env bash
# Makes the weights of segmenter=efficient_unet: views of built-in towns and open city models, from 22 m to 300 m
# and in every paint, photos without buildings as ground, and EfficientNet-Lite0 as ImageNet taught it, which stays
# as it is until photos with traced masks come last. Two cores, no GPU, extra [torch].
# Usage: recipes/efficient_unet.sh OUT CITIES PHOTOS NEGATIVES..., with OUT a folder for everything, CITIES that of the
# open models, PHOTOS that of the photos that recipes/traced names, a folder per place, NEGATIVES folders of photos
# without buildings. Given again it goes on where it stopped. WITHOUT=bogota (or boruszyn) leaves that place's traced photos
# out, for a network to be measured there: weights3_without_bogota.
set -euo pipefail
out=$1 cities=$2 photos=$3
shift 3
negatives=$(IFS=,; echo "$*")
views=${VIEWS:-40} first=${FIRST_EPOCHS:-5} second=${SECOND_EPOCHS:-1}

paints=('look.repaint=[0.2,1]' 'look.tint_jitter=[0.02,0.3]' 'look.sun_share=[0.05,0.92]'
    'look.sun_elevation_deg=[12,70]' 'look.exposure=[0.7,1.5]' 'look.contrast=[0.85,1.4]')
generate() { # set, views, further settings
    lodbench generate-training-data out="$out/$1" limit="$2" count="$((4 * $2))" "${@:3}" \
        val_share=0 test_share=0 sheet=128
}
far() { # set, further settings: 50 to 300 m
    generate "train/far/$1" "$views" "${paints[@]}" sampling=random min_buildings=0.02 size='[640,480]' \
        height='[50,60,75,90,110,135,165,200,250,300]' pitch='[0,4,8,12,16,24,32,40,50,60,70]' "${@:2}"
}
near() { # set, further settings: large roofs that leave the picture
    generate "train/near/$1" "$views" "${paints[@]}" sampling=random min_buildings=0.1 size='[512,384]' \
        height='[22,28,35,42,50,60,75]' pitch='[0,0,4,8,15,25,40,55]' "${@:2}"
}
open_land() { # set, further settings: with and without buildings
    generate "train/open/$1" "$views" "${paints[@]}" sampling=anywhere min_buildings=0 size='[512,384]' \
        height='[40,50,60,75,90,120,160,220]' pitch='[0,0,4,8,12,20,30,45]' "${@:2}"
}
fields=(84 62 70 75)
for seed in 1 2 3 4 5; do
    far "town$seed" city="demo:$seed" lod=3 seed="$((100 + seed))" fov_deg="${fields[seed % 4]}"
    generate "train/painted/town$seed" "$((4 * views))" city="demo:$seed" lod=3 seed="$((40 + seed))" \
        fov_deg="$((60 + 4 * seed))" look.repaint='[0.3,1]' look.tint_jitter='[0.02,0.3]' sampling=random \
        min_buildings=0.02 size='[512,384]' height='[60,75,90,105,120,135,150,165,180,200]' pitch='[0,10,20,30,40,50,60]'
done
near town3 city=demo:3 lod=3 seed=303 fov_deg=84
near town5 city=demo:5 lod=3 seed=305 fov_deg=70
open_land town2 city=demo:2 lod=3 seed=152 fov_deg=75
open_land town3 city=demo:3 lod=3 seed=203 fov_deg=80
open_land town6 city=demo:6 lod=3 seed=206 fov_deg=70
lower=$cities/germany_lod2
while read -r name number fov settings; do
    # shellcheck disable=SC2086 # several settings
    far "$name" seed="$((100 + number))" fov_deg="$fov" $settings
    # shellcheck disable=SC2086
    near "$name" seed="$((300 + number))" fov_deg="$fov" $settings
    # shellcheck disable=SC2086
    open_land "$name" seed="$((200 + number))" fov_deg="$fov" $settings
done <<EOF
delft 11 70 source=threedbag lod=2.2 city=$cities/3dbag/3dbag_v210908_fd2cee53_5907_subset.json
nishitokyo 12 84 source=plateau city=$cities/plateau/53395404_bldg_6697_op.gml
rotterdam 13 75 city=$cities/netherlands_other/3-20-DELFSHAVEN.city.json
berlin 14 65 city=$lower/berlin_open_data_sample_data.citygml
nrw 15 70 city=$lower/LoD2_32_280_5657_1_NW.gml
hamburg 16 80 city=$lower/LoD2_576_5950_1_HH_2016.xml
numazu 17 80 source=plateau city=$cities/plateau/51311568_bldg_6697_op.gml
EOF
generate val/town9 30 city=demo:9 lod=3 seed=9 fov_deg=70 training@look=hard sampling=random min_buildings=0.02 \
    size='[640,480]' height='[50,60,75,90,110,135,165,200,250,300]' pitch='[0,4,8,12,16,24,32,40,50,60,70]'

train() { # folder to write, further settings
    lodbench train segmenter=efficient_unet data="$out/train" val_data="$out/val" out="$out/$1" \
        negatives="[$negatives]" threads=1 precision=bfloat16 device=cpu schedule.augment=strong \
        schedule.warmup=0.05 schedule.val_every=1 "${@:2}"
}
export OMP_NUM_THREADS=1
train weights1 schedule.epochs="$first" schedule.scale='[0.7,2]' schedule.encoder_rate=0
# On squares that large roofs fit into; then the mean of both trainings, which is better than either.
large=(schedule.crop=352 schedule.batch=4 schedule.scale='[0.7,2.5]')
train weights2 "${large[@]}" schedule.epochs="$second" schedule.muon_lr=0.015 schedule.encoder_rate=0 \
    init="$out/weights1/checkpoint.pt" average="[$out/weights1/checkpoint.pt]"
# Real roofs, the encoder learning slowly; again the mean, which keeps what is known of other places.
without=${WITHOUT:+_without_$WITHOUT}
python "$(dirname "$0")/traced_masks.py" "$photos" "$out/traced$without"
[ -z "$without" ] || rm -r "${out:?}/traced$without/$WITHOUT"
drawn=$out/weights2/averaged.safetensors
train "weights3$without" "${large[@]}" schedule.epochs=1 schedule.muon_lr=0.004 schedule.lr=0.0006 schedule.encoder_rate=0.1 \
    traced="[$out/traced$without]" traced_share=0.4 init="$drawn" average="[$drawn]"
if [ -z "$without" ]; then
    echo "efficient_unet.onnx and training.json (as efficient_unet.json) of $out/weights3 belong in lodbench/segmentation/weights"
fi
