/*
   $about
*/
#include "$name.h"
#include <math.h>

$tables

void ${name}_init($name *block)
{
    $defaults
    ${name}_reset(block);
}

void ${name}_reset($name *block)
{
    $start
}

void ${name}_step($name *block, const ${name}_measured *measured, ${name}_setpoints *setpoints)
{
    int again = 1, sample;
    $places
    $work

    for (sample = 0; again && sample < $samples; sample++) {
        $body
    }
}
