/* stm32g4.h: the registers of an STM32G4 that the example uses, under the names that the reference manual RM0440 gives them. A project
 * that has ST's CMSIS headers includes those instead. */
#ifndef STM32G4_H
#define STM32G4_H

#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define BIT(n) (1u << (n))

#define NVIC_ISER(n) REGISTER(0xE000E100u + 4u * (n))
#define NVIC_IPR(n) (*(volatile uint8_t *)(0xE000E400u + (n)))
#define SCB_CPACR REGISTER(0xE000ED88u)
#define UID(n) REGISTER(0x1FFF7590u + 4u * (n))

#define RCC 0x40021000u
#define RCC_CR REGISTER(RCC)
#define RCC_CFGR REGISTER(RCC + 0x08u)
#define RCC_PLLCFGR REGISTER(RCC + 0x0Cu)
#define RCC_AHB1ENR REGISTER(RCC + 0x48u)
#define RCC_AHB2ENR REGISTER(RCC + 0x4Cu)
#define RCC_APB1ENR1 REGISTER(RCC + 0x58u)
#define RCC_APB2ENR REGISTER(RCC + 0x60u)
#define RCC_CCIPR REGISTER(RCC + 0x88u)
#define RCC_CRRCR REGISTER(RCC + 0x98u)
#define PWR_CR5 REGISTER(0x40007080u)
#define FLASH_ACR REGISTER(0x40022000u)
#define RNG_CR REGISTER(0x50060800u)
#define RNG_SR REGISTER(0x50060804u)
#define RNG_DR REGISTER(0x50060808u)

struct gpio {
    volatile uint32_t MODER, OTYPER, OSPEEDR, PUPDR, IDR, ODR, BSRR, LCKR, AFR[2], BRR;
};
#define GPIOA ((struct gpio *)0x48000000u)
#define GPIOB ((struct gpio *)0x48000400u)

struct timer {
    volatile uint32_t CR1, CR2, SMCR, DIER, SR, EGR, CCMR1, CCMR2, CCER, CNT, PSC, ARR, RCR, CCR1, CCR2, CCR3, CCR4, BDTR;
};
#define TIM1 ((struct timer *)0x40012C00u)
#define TIM2 ((struct timer *)0x40000000u)
#define TIM4 ((struct timer *)0x40000800u)

struct adc {
    volatile uint32_t ISR, IER, CR, CFGR, CFGR2, SMPR1, SMPR2, r1, TR1, TR2, TR3, r2, SQR[4], DR, r3[2], JSQR, r4[4], OFR[4], r5[4],
        JDR[4];
};
#define ADC1 ((struct adc *)0x50000000u)
#define ADC12_CCR REGISTER(0x50000308u)

struct usart {
    volatile uint32_t CR1, CR2, CR3, BRR, GTPR, RTOR, RQR, ISR, ICR, RDR, TDR, PRESC;
};
#define USART2 ((struct usart *)0x40004400u)

struct dma_channel {
    volatile uint32_t CCR, CNDTR, CPAR, CMAR;
};
#define DMA1_CHANNEL(n) ((struct dma_channel *)(0x40020008u + 0x14u * ((n) - 1u)))
#define DMAMUX_CCR(n) REGISTER(0x40020800u + 4u * ((n) - 1u))
enum { DMAMUX_USART2_RX = 26, DMAMUX_USART2_TX = 27 };

#define FDCAN 0x40006400u
#define FDCAN_CCCR REGISTER(FDCAN + 0x18u)
#define FDCAN_NBTP REGISTER(FDCAN + 0x1Cu)
#define FDCAN_IR REGISTER(FDCAN + 0x50u)
#define FDCAN_IE REGISTER(FDCAN + 0x54u)
#define FDCAN_ILE REGISTER(FDCAN + 0x5Cu)
#define FDCAN_RXGFC REGISTER(FDCAN + 0x80u)
#define FDCAN_RXF0S REGISTER(FDCAN + 0x90u)
#define FDCAN_RXF0A REGISTER(FDCAN + 0x94u)
#define FDCAN_TXBC REGISTER(FDCAN + 0xC0u)
#define FDCAN_TXBRP REGISTER(FDCAN + 0xC8u)
#define FDCAN_TXBAR REGISTER(FDCAN + 0xCCu)
#define FDCAN_TXBCR REGISTER(FDCAN + 0xD0u)
#define FDCAN_FILTER(n) REGISTER(0x4000A400u + 4u * (n))
#define FDCAN_RX(n) ((volatile uint32_t *)(0x4000A4B0u + 72u * (n)))
#define FDCAN_TX(n) ((volatile uint32_t *)(0x4000A678u + 72u * (n)))

enum { ADC1_2_NUMBER = 18, FDCAN1_NUMBER = 21, TIM4_NUMBER = 30 };

#endif
